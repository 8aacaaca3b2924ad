"""What the blocks of the documents show: each form makes Markdown of results, of stored runs or of the code itself."""

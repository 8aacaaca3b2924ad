"""What the blocks of the documents show: Markdown of results, of stored runs or of the code itself."""

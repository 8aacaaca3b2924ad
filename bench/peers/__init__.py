"""Our training next to what one would use instead: each peer trains for the same time in a process of its own."""

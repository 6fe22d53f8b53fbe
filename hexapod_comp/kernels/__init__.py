"""Everything compiled, and nothing else: arrays and numbers in, arrays and numbers out."""

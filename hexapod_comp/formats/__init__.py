"""How files and reports are read and written, whatever is in them."""

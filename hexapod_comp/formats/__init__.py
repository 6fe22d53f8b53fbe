"""Reading and writing of files of any content: YAML, CSV, JSON, texts, pictures and HTML pages."""

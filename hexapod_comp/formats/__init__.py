"""Reading and writing of files, texts, pictures and HTML pages, independent of their content."""

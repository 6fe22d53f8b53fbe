"""Reading and writing of files and reports, independent of their content."""

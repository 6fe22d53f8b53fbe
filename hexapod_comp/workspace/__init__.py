"""The workspace study of v. Daake, Vetter, Böhm and Zirn: how much each machine error moves the tool, and where."""

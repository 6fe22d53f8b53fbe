"""The workspace study of Daake, Vetter, Böhm and Zirn: how much each machine error moves the tool, and where."""

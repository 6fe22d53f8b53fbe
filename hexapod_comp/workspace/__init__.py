"""Which error hurts where: the workspace study of v. Daake, Vetter, Böhm and Zirn."""

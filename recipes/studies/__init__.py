"""Studies: what answered one question once. Each is a program, `python -m recipes.studies.NAME`, on top of the library."""

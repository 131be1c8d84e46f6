"""Studies, each of which answered one question: programs, ``python -m recipes.studies.NAME``, that use the library."""

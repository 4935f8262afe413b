"""One short module a stage: load, call the library, save, say what came out."""

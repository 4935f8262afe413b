"""One short file a stage: load, call the library, save."""

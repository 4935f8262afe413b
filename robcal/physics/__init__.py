"""The library of physical causes: one small declarative entry each."""

"""Large images made of tiles, each oriented by the crosses of a glass grid (reseau scanning)."""

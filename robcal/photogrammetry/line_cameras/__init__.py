"""Systems of linear cameras: each reading is a plane, three planes are a point."""

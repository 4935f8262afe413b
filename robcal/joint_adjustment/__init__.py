"""One adjustment of all marks of a station, its cameras, its body and the robot that carries the body."""

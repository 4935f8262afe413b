"""Files of people: robots, bodies, cameras, joint logs and measurements, read with a sentence for every fault."""

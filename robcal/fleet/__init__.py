"""Many robots of one kind: their usual deviations, those that are out of the ordinary, batches that differ."""

"""Labels from bodies laid over the masks of a passage: one size and form per vehicle, one place per sighting."""

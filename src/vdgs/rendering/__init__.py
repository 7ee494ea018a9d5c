"""`vdgs render`: views and camera paths of a run, as pictures or as a film."""

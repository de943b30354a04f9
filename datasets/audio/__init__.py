"""Sound: reading it, resampling it, and the audio features that dances are conditioned on."""

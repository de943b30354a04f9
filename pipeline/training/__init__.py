"""What a training notes of itself: flight recorder, crash bundles, replays, branches, profiles."""

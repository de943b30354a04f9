"""What a training notes of itself while it runs: flight recorder, crash bundles, replays, branches, profiles."""

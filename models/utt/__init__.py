"""UDE's unified token transformer: motion tokens from embedded conditions of any modality."""

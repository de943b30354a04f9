"""Pictures, video and the self-contained viewer."""

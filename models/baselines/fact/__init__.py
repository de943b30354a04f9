"""FACT (AI Choreographer, Li et al. 2021): the next frames of a dance, from those before and the music."""

"""Bailando (Li et al. 2022), from its paper: codes of two halves of the body, a GPT, actor and critic."""

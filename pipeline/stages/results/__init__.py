"""Stages that generate, measure and report."""

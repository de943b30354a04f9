"""Stages that make or prepare data."""

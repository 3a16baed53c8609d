"""Meshes too large to commit, made by the program itself."""

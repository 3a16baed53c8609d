"""`causticmpi inspect`: what the preprocess of a scene found, as the paper's Figures 1 and 2 and as numbers."""

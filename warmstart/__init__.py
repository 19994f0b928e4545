"""Where good motions come from: trajectory optimisation, clips and their certificates."""

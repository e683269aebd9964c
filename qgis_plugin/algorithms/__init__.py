"""The algorithms of the toolbox, one module for each."""

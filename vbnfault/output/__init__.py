"""How people look at a dataset, a sample or a flare, and take it elsewhere."""

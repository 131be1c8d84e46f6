"""Reading and writing policies. Nothing in a checkpoint is ever executed."""

"""robosuite tasks as TorchRL environments, and scripted experts for them."""

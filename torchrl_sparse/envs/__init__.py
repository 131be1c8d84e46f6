"""robosuite tasks and other benchmarks of Diffusion Policy as TorchRL environments, and scripted experts for them."""

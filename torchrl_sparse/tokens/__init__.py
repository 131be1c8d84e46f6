"""Sparsity over visual tokens: which patches of the cameras' images a vision-language-action model goes on computing."""

"""Vision-language-action policies (the OpenVLA-OFT architecture at any size) and the interface of what prunes their tokens."""

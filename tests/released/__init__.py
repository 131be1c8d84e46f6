"""The released code of methods, run beside ours: needs a checkout of it on ``PYTHONPATH``, of which nothing is kept here."""

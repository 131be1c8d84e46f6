"""Processes that begin with everything imported, as copies of one server's that did so once."""

import multiprocessing

FORKED = multiprocessing.get_context("forkserver")
FORKED.set_forkserver_preload(["tests.imported"])

"""What is seen of many recipes: arguments of calls, files, and words that are printed."""

import re


def argument(function, name, index=0):
    """An argument of a call of a watched function."""
    return lambda run: run.call(function, index)[name]


def size(function, name):
    """How long that argument is."""
    return lambda run: len(run.call(function)[name])


def first(function, name, origin=0):
    """The first of that argument, less an origin."""
    return lambda run: run.call(function)[name][0] - origin


def content(file, *names):
    """What a JSON file of the output has under nested names."""

    def read(run):
        found = run.json(file)
        for name in names:
            found = found[name]
        return found

    return read


def printed(pattern, read=str):
    """The first group of a pattern in what is printed, None if it is not there."""

    def find(run):
        found = re.search(pattern, run.printed)
        return found and read(found[1])

    return find


def written(path):
    """Whether a path of the run's folder was written."""
    return lambda run: (run.folder / path).exists()


def device(function="DiffusionPolicy.to"):
    """The device that a policy is moved to."""
    return lambda run: str(run.call(function)["args"][0])

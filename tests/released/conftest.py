from importlib.util import find_spec

# Doctests import every module; these need the release.
collect_ignore = [] if find_spec("TTSInfer") else ["compare.py", "tts.py"]

"""Scripted experts, one file a task, and what their operators do besides what they mean; never human."""

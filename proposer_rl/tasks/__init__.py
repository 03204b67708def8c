"""The shipped environments, each in a folder that nothing else knows."""

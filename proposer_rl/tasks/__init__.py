"""The environments that come along, each in a folder that nothing else knows."""

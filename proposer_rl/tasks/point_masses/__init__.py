"""The point mass before a gate of SPDL and CurrOT."""

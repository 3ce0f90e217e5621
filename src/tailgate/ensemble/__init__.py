"""The standard attack ensemble: attacks that are searched for, instead of listed by hand."""

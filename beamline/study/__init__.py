"""Studies of one scan: which views, how many and from where; each by a table of reconstructions of chosen views."""

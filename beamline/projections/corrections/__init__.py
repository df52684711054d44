"""Steps: corrections of views, one a file; `registry` has a line for each."""

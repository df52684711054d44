"""Reports: self-contained HTML pages, pictures, and the record of a fit."""

"""Reports: self-contained HTML pages, pictures, figures of merit, and the history of a fit."""

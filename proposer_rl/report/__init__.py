"""From run folders to statistics, tables, figures and a page."""

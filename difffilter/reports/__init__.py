"""Pages that stand alone: HTML, Markdown and JSON, with figures."""

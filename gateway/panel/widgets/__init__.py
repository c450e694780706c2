"""Parts of views: tables, charts, prompts; each draws in the browser what its Python sends."""

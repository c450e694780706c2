"""The panel: what the aircraft tell, as a page in a browser. A process of its own."""

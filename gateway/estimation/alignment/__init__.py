"""The attitude out of motion alone: how one that is lost, doubted or not yet known is found."""

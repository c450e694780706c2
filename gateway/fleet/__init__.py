"""The fleet: the vehicles of many sites for the ground stations here, over Zenoh."""

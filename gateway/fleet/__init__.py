"""The fleet: many sites as one picture for the ground stations here; Zenoh carries it."""

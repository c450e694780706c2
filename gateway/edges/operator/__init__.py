"""Status and control of the gateway for its operator."""

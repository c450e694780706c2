"""What is asked of an aircraft in more than one message: parameters, files, calibrations."""

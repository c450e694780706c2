"""Files of other programs' formats: opened by the packages that know them, which are extras."""

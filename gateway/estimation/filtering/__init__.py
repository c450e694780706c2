"""What `complementary` and `eskf` share: how samples and fixes reach a filter, and its clock."""

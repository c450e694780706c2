"""The default estimator: a quaternion complementary filter with GPS and compass references."""

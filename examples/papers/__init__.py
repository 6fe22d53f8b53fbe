"""Every table and figure of the papers that this package comes from, computed and laid beside what they print."""

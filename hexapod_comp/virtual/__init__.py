"""Virtual machines: imperfections drawn at random, drives, instruments."""

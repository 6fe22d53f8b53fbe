"""Machines that do not exist: imperfections drawn at random, drives, instruments."""

"""Virtual machines: random imperfections, simulated strut drives, simulated instruments, warm-up and physics."""

"""What every laneweave process shares: lattice, scenario, messages, keys, transport."""

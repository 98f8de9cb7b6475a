"""What accuracy costs in time: sweeps over options, tables and figures."""

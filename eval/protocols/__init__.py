"""How public benchmarks score meshes."""

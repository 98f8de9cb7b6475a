// Planes of the flat sides that meet at the creases of a mesh from voxels.
//
// Voxels chamfer creases: between two flat parts lie a row or two of faces that belong to neither. The faces farther
// away on either side locate the crease, as in Attene et al. 2005 (Sharpen & Bend) and, for a signed distance, Kobbelt
// et al. 2001.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

struct CreaseRules {
  double contrast;  // of `average_normals`, as is the next
  int normal_rounds;
  double flat;     // least cosine between a flat face and the faces around it
  double side;     // cosine: normals at a larger angle belong to another side
  double crease;   // largest cosine between the normals of sides that meet at a crease
  double even;     // least mean cosine between the normals of a side's faces and that of the side
  int rings;       // rings of faces around an edge in which sides are searched for
  double falloff;  // standard deviation of their weight with distance beyond the first edge length, in edges
  double wide;     // least width of a side across the crease, in edges
};

// Edges across creases and edges beside them whose ends lie on known sides, sorted by the numbers of their ends.
struct CreaseEdges {
  std::vector<int64_t> end;      // (N, 2)
  std::vector<double> plane;     // (N, 2, 4) unit normal n and offset n . x of the side of each end
  std::vector<uint8_t> crosses;  // (N,) whether the two meet at a crease between the ends
  std::vector<double> length;    // (N,) median length of the edges around
};

// Finds the sides and creases around edges of faces that are not flat. `corner` (faces, 3) are rows of `vertex`
// (vertices, 3).
//
// Normals are first averaged within flat parts. A side is a connected set of flat faces near the edge with similar
// normals; its plane is their weighted mean, and an end of the edge lies on the side with the nearest plane. Two sides
// make a crease if their normals differ both in the mean and extrapolated to the edge by a linear fit to the mesh's own
// normals: a surface that bends all the way is round. Tested are edges around which normals differ by that much, and
// then those beside edges across a crease, with an end in a face that has an end of such an edge. Memory: 360 bytes per
// face and 14 for each thread, 100 per edge of a face that is not flat. Vertices and faces are fewer than 2^31. The
// result is identical for any number of threads.
CreaseEdges crease_edges(const CreaseRules& how, int64_t vertices, int64_t faces, const int64_t* corner,
                         const double* vertex);

}  // namespace linprim

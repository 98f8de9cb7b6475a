// The planes that meet at the creases of a mesh of voxels.
//
// Voxels cut creases off: between two flat parts lie a row or two of faces that belong to neither. What lies beyond on
// either side tells where the crease is, as in Attene et al. 2005 (Sharpen & Bend) and, of a signed distance, Kobbelt
// et al. 2001.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

struct CreaseRules {
  double contrast;  // of `average_normals`, as is the next
  int normal_rounds;
  double flat;     // cosine: a face is flat if those around it are that near to it
  double side;     // cosine: normals with more between them are of another side
  double crease;   // cosine: sides with less between their normals meet at a crease
  double even;     // cosine: what the faces of a side have between theirs and its normal, in the mean, at least
  int rings;       // so many faces away from an edge are asked
  double falloff;  // standard deviation of how much they count, beyond the first edge length, in edges
  double wide;     // what a side reaches over, across the crease, at least, in edges
};

// Edges across creases, and those beside them, whose ends lie on known sides, by numbers of their ends in order.
struct CreaseEdges {
  std::vector<int64_t> end;      // (N, 2)
  std::vector<double> plane;     // (N, 2, 4) unit normal n and offset n . x of the side of each end
  std::vector<uint8_t> crosses;  // (N,) whether the two meet at a crease between the ends
  std::vector<double> length;    // (N,) of the edges around, in the median
};

// `corner` (faces, 3) are rows of `vertex` (vertices, 3). Of edges of faces that are not flat, once their normals are
// averaged within flat parts, flat faces around that hang together, with normals as near as those of one side, are a
// side; its plane is the weighted mean of its faces, and an end lies on the side whose plane is nearest. Two sides make
// a crease if their normals, as they are on average and as they go on to the edge by the linear fit to those of the
// mesh, differ: what bends all the way is round. Asked are edges around which normals differ by as much, and then those
// beside edges across a crease: of which an end shares a face with one of their ends. Memory: 360 bytes per face and 14
// for each thread, 100 per edge of a face that is not flat. Vertices and faces are fewer than 2^31. The same bits for
// any number of threads.
CreaseEdges crease_edges(const CreaseRules& how, int64_t vertices, int64_t faces, const int64_t* corner,
                         const double* vertex);

}  // namespace linprim

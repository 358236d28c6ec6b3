#version 460
// raster/backward, for software devices, where a subgroup of 8 or 4 has the tile to itself.
#extension GL_GOOGLE_include_directive : require

#define LANES 8
#include "raster/backward.glsl"

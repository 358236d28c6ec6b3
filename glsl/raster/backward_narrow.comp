#version 460
// raster/backward with 8 invocations per tile, for software devices, whose subgroups are narrow.
#extension GL_GOOGLE_include_directive : require

#define LANES 8
#include "raster/backward.glsl"

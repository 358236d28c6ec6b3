#version 460
// Gradients of the splats, for devices whose subgroups are wide.
#extension GL_GOOGLE_include_directive : require

#define LANES 32
#include "raster/backward.glsl"

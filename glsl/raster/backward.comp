#version 460
// Gradients with respect to the splats, for devices with wide subgroups.
#extension GL_GOOGLE_include_directive : require

#define LANES 32
#include "raster/backward.glsl"

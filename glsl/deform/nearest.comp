#version 460
// Finds the k nearest control points of every listed point, nearest first, equal distances by
// index. A control point whose squared distance is not finite is not a neighbour.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Ids { uint ids[]; };
layout(scalar, binding = 1) readonly buffer Positions { vec3 positions[]; };
layout(scalar, binding = 2) readonly buffer Nodes { vec3 nodes[]; };
layout(std430, binding = 3) writeonly buffer Neighbours { uint neighbours[]; };

layout(push_constant) uniform Params {
    uint rows;
    uint node_count;
    uint listed;    // whether ids name the points; else row r is point r
};

// Largest number of neighbours per point.
const uint MOST_NEIGHBOURS = 16u;
// Neighbours per point, at least 1.
layout(constant_id = 0) const uint K = 4u;

#include "common/grid.glsl"

void main() {
    uint row = group_index() * 64u + gl_LocalInvocationIndex;
    if (row >= rows) {
        return;
    }
    uint id = listed != 0u ? ids[row] : row;
    vec3 point = positions[id];
    const float FAR = uintBitsToFloat(0x7f800000u);
    float distances[MOST_NEIGHBOURS];
    uint found[MOST_NEIGHBOURS];
    // The largest of the K distances.
    float worst = FAR;
    for (uint s = 0u; s < K; s++) {
        distances[s] = FAR;
        found[s] = 0xffffffffu;
    }
    for (uint node = 0u; node < node_count; node++) {
        vec3 d = point - nodes[node];
        // `precise` prevents fused multiply-adds, so that ties are resolved as in the oracle.
        precise float distance_here = d.x * d.x;
        distance_here = distance_here + d.y * d.y;
        distance_here = distance_here + d.z * d.z;
        if (distance_here < worst) {
            // Entries that are nearer or equally near stay in front. All entries behind them move
            // back by one.
            bool placed = false;
            float carried = distance_here;
            uint carried_node = node;
            for (uint s = 0u; s < K; s++) {
                placed = placed || carried < distances[s];
                if (placed) {
                    float d_old = distances[s];
                    uint n_old = found[s];
                    distances[s] = carried;
                    found[s] = carried_node;
                    carried = d_old;
                    carried_node = n_old;
                }
                worst = distances[s];
            }
        }
    }
    for (uint s = 0u; s < K; s++) {
        neighbours[row * K + s] = found[s];
    }
}

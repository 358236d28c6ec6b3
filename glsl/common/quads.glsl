// How a workgroup of 32 covers a tile of 16×16 pixels: each invocation has two quads of 2×2 side by
// side, and 8 invocations cover 8×8 pixels, so that a subgroup of any size covers a compact block. A
// splat that misses the block is skipped by the whole subgroup; what a splat costs a subgroup (its
// broadcast, the sums of its gradients) is shared by eight pixels per invocation. Needs
// common/tile.glsl.
const uint QUADS = 2u;

uint lane_index() {
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// The tile's first pixel.
uvec2 tile_origin(uint tile, uvec2 grid) {
    return uvec2(tile % grid.x, tile / grid.x) * TILE;
}

// First pixel, within the tile, of an invocation's quads.
uvec2 quads_origin(uint lane) {
    uint x = (lane & 1u) | ((lane >> 2) & 2u);
    uint y = ((lane >> 1) & 3u) | ((lane >> 2) & 4u);
    return uvec2(4u * x, 2u * y);
}

// Pixels of a quad: (0,0) (1,0) (0,1) (1,1).
const vec4 QUAD_X = vec4(0.0, 1.0, 0.0, 1.0);
const vec4 QUAD_Y = vec4(0.0, 0.0, 1.0, 1.0);

// Which pixels of the quad lie in the image.
bvec4 quad_inside(uvec2 origin, uvec2 size) {
    bvec2 x = lessThan(uvec2(origin.x, origin.x + 1u), size.xx);
    bvec2 y = lessThan(uvec2(origin.y, origin.y + 1u), size.yy);
    return bvec4(x.x && y.x, x.y && y.x, x.x && y.y, x.y && y.y);
}

uint quad_pixel(uvec2 origin, uint k, uint width) {
    return (origin.y + (k >> 1)) * width + origin.x + (k & 1u);
}

// The rectangle of pixel centres that the subgroup's quads cover.
void subgroup_block(vec2 corner, out vec2 lowest, out vec2 highest) {
    lowest = subgroupMin(corner);
    highest = subgroupMax(corner) + vec2(3.0, 1.0);
}

// The splat's power at the quad's pixels: the squared length of their whitened offsets.
vec4 quad_power(vec2 mean, vec3 conic, vec2 corner, out vec4 across, out vec4 along) {
    vec4 dx = corner.x - mean.x + QUAD_X;
    vec4 dy = corner.y - mean.y + QUAD_Y;
    across = conic.x * dx + conic.y * dy;
    along = conic.z * dy;
    return across * across + along * along;
}

// By ballot, so that devices need not offer votes.
bool subgroup_any(bool here) {
    return subgroupBallot(here) != uvec4(0u);
}

// Mapping of a workgroup of LANES (32 or 8) invocations to the 16×16 pixels of a tile. The
// workgroup processes BLOCKS blocks one after the other. In each block an invocation handles two
// adjacent quads of 2×2 pixels, so 8 invocations cover 8×8 pixels and a subgroup of any size covers
// a compact block. The whole subgroup skips a splat that misses its block. The cost of a splat per
// subgroup (its broadcast, the reduction of its gradients) is shared by eight pixels per
// invocation, and the cost of its load by all blocks. Requires common/tile.glsl.
const uint BLOCKS = 32 / LANES;
const uint QUADS = 2u;
// One call per block with a constant argument, because compilers do not unroll a loop that contains
// loops.
#if LANES == 32
#define EACH_BLOCK(work) work(0u);
#else
#define EACH_BLOCK(work) work(0u); work(1u); work(2u); work(3u);
#endif

uint lane_index() {
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// The upper left pixel of the tile.
uvec2 tile_origin(uint tile, uvec2 grid) {
    return uvec2(tile % grid.x, tile / grid.x) * TILE;
}

// The upper left pixel, relative to the tile, of an invocation's quads in a block.
uvec2 quads_origin(uint block) {
    uint lane = block * LANES + lane_index();
    uint x = (lane & 1u) | ((lane >> 2) & 2u);
    uint y = ((lane >> 1) & 3u) | ((lane >> 2) & 4u);
    return uvec2(4u * x, 2u * y);
}

// Offsets of a quad's pixels, in the order (0,0) (1,0) (0,1) (1,1).
const vec4 QUAD_X = vec4(0.0, 1.0, 0.0, 1.0);
const vec4 QUAD_Y = vec4(0.0, 0.0, 1.0, 1.0);

// Whether each pixel of the quad lies in the image.
bvec4 quad_inside(uvec2 origin, uvec2 size) {
    bvec2 x = lessThan(uvec2(origin.x, origin.x + 1u), size.xx);
    bvec2 y = lessThan(uvec2(origin.y, origin.y + 1u), size.yy);
    return bvec4(x.x && y.x, x.y && y.x, x.x && y.y, x.y && y.y);
}

uint quad_pixel(uvec2 origin, uint k, uint width) {
    return (origin.y + (k >> 1)) * width + origin.x + (k & 1u);
}

// The splat's power at the quad's pixels: the squared length of their whitened offsets (across,
// along). The Gaussian falls off as exp(-power).
vec4 quad_power(vec2 mean, vec3 conic, vec2 corner, out vec4 across, out vec4 along) {
    vec4 dx = corner.x - mean.x + QUAD_X;
    vec4 dy = corner.y - mean.y + QUAD_Y;
    across = conic.x * dx + conic.y * dy;
    along = conic.z * dy;
    return across * across + along * along;
}

// Whether lanes exchange values by shuffles only. Software devices shuffle all lanes at once, but
// process subgroup arithmetic, ballots and broadcasts one lane at a time. On some GPUs a shuffle is
// expensive and a broadcast cheap.
layout(constant_id = 0) const bool SHUFFLES = false;

#define FROM_LANE(x, lane) (SHUFFLES ? subgroupShuffle(x, lane) : subgroupBroadcast(x, lane))

// Reduces the lanes' values with the function `folded` in a butterfly of shuffles: pairs, pairs of
// pairs, and so on. Every lane receives the result.
#define SUBGROUP_FOLD(x, folded)                                                                   \
    for (uint mask = 1u; mask < min(gl_SubgroupSize, LANES); mask *= 2u) {                         \
        x = folded(x, subgroupShuffleXor(x, mask));                                                \
    }

vec2 added(vec2 a, vec2 b) {
    return a + b;
}
vec4 added(vec4 a, vec4 b) {
    return a + b;
}
uint either(uint a, uint b) {
    return a | b;
}

// The subgroup's ballot, one bit per lane.
uint subgroup_ballot(bool here) {
    if (SHUFFLES) {
        uint bits = here ? 1u << gl_SubgroupInvocationID : 0u;
        SUBGROUP_FOLD(bits, either)
        return bits;
    }
    return subgroupBallot(here).x;
}

// The rectangle of pixel centres that the subgroup's quads cover in one block.
void subgroup_block(vec2 corner, out vec2 lowest, out vec2 highest) {
    lowest = corner;
    highest = corner;
    SUBGROUP_FOLD(lowest, min)
    SUBGROUP_FOLD(highest, max)
    highest += vec2(3.0, 1.0);
}

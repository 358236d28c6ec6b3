// How a workgroup of LANES (32 or 8) invocations covers a tile of 16×16 pixels: in BLOCKS blocks, one
// after the other, of each of which an invocation has two quads of 2×2 side by side. 8 invocations
// cover 8×8 pixels, so that a subgroup of any size covers compact blocks. A splat that misses a block
// is skipped by the whole subgroup; what a splat costs a subgroup (its broadcast, the sums of its
// gradients) is shared by eight pixels per invocation, and its load by the blocks. Needs
// common/tile.glsl.
const uint BLOCKS = 32 / LANES;
const uint QUADS = 2u;
// One call per block, each with a constant: compilers do not unroll loops around loops.
#if LANES == 32
#define EACH_BLOCK(work) work(0u);
#else
#define EACH_BLOCK(work) work(0u); work(1u); work(2u); work(3u);
#endif

uint lane_index() {
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
}

// The tile's first pixel.
uvec2 tile_origin(uint tile, uvec2 grid) {
    return uvec2(tile % grid.x, tile / grid.x) * TILE;
}

// First pixel, within the tile, of an invocation's quads in a block.
uvec2 quads_origin(uint block) {
    uint lane = block * LANES + lane_index();
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

// The splat's power at the quad's pixels: the squared length of their whitened offsets.
vec4 quad_power(vec2 mean, vec3 conic, vec2 corner, out vec4 across, out vec4 along) {
    vec4 dx = corner.x - mean.x + QUAD_X;
    vec4 dy = corner.y - mean.y + QUAD_Y;
    across = conic.x * dx + conic.y * dy;
    along = conic.z * dy;
    return across * across + along * along;
}

// Software devices shuffle all lanes at once, but go through them one by one for arithmetic over a
// subgroup, for ballots and for broadcasts. To some GPUs a shuffle is dear and a broadcast cheap.
layout(constant_id = 0) const bool SHUFFLES = false;

#define FROM_LANE(x, lane) (SHUFFLES ? subgroupShuffle(x, lane) : subgroupBroadcast(x, lane))

// Folds the lanes' values, pairs, pairs of pairs, and so on; every lane has the result.
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

// One bit per lane.
uint subgroup_ballot(bool here) {
    if (!SHUFFLES) {
        return subgroupBallot(here).x;
    }
    uint bits = here ? 1u << gl_SubgroupInvocationID : 0u;
    SUBGROUP_FOLD(bits, either)
    return bits;
}

// The rectangle of pixel centres that the subgroup's quads cover.
void subgroup_block(vec2 corner, out vec2 lowest, out vec2 highest) {
    lowest = corner;
    highest = corner;
    SUBGROUP_FOLD(lowest, min)
    SUBGROUP_FOLD(highest, max)
    highest += vec2(3.0, 1.0);
}

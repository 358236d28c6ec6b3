#version 460
// Exclusive prefix sums by a single workgroup. Each invocation passes twice over its own range of
// values. This is for so few values that further dispatches would cost more than they save.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require

layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(scalar, binding = 1) readonly buffer Values { uvec4 values[]; };
layout(scalar, binding = 2) writeonly buffer Prefix { uvec4 prefix[]; };
layout(std430, binding = 3) writeonly buffer Total { uint total[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
    uint total_at;
};

#include "common/workgroup_sum.glsl"
#include "scan/vec4.glsl"
#include "scan/prefix.glsl"

void main() {
    uint n = min(count[count_at], capacity);
    uint own = 4u * (n / 1024u + (n % 1024u == 0u ? 0u : 1u));
    uint begin = min(own * sum_index(), n);
    uint end = min(begin + own, n);
    uint tail = max(begin, end - end % 4u);
    uint sum = 0u;
    for (uint at = begin; at < tail; at += 4u) {
        sum += sum_of(values[at / 4u]);
    }
    for (uint at = tail; at < end; at++) {
        sum += value(at);
    }
    uint all;
    uint running = exclusive_sum(sum, all);
    for (uint at = begin; at < tail; at += 4u) {
        write_vec4(at, values[at / 4u], running);
    }
    write_tail(tail, end, running);
    if (sum_index() == 0u) {
        total[total_at] = all;
    }
}

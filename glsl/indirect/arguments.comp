#version 460
// Turns a count on the device into the grid of a dispatch over that many items.

layout(local_size_x = 1) in;

layout(std430, binding = 0) readonly buffer Count { uint count[]; };
layout(std430, binding = 1) writeonly buffer Arguments { uint arguments[]; };

layout(push_constant) uniform Params {
    uint count_at;
    uint capacity;
    uint per_group;
    uint group_limit;
    uint arguments_at;
};

void main() {
    uint items = min(count[count_at], capacity);
    uint groups = items / per_group + (items % per_group == 0u ? 0u : 1u);
    uint rows = max(groups / group_limit + (groups % group_limit == 0u ? 0u : 1u), 1u);
    arguments[arguments_at] = rows == 1u ? groups : group_limit;
    arguments[arguments_at + 1u] = rows;
    arguments[arguments_at + 2u] = 1u;
}

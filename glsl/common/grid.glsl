// The linear index of the workgroup in a grid that may be folded into two axes (Groups::linear).
uint group_index() {
    return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
}

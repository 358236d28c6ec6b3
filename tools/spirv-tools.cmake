# Of SPIRV-Tools, which shaderc builds whole, only what shaderc links: a third of all its files less.
set(SKIP_SPIRV_TOOLS_INSTALL ON)
cmake_language(DEFER CALL set_property TARGET
    SPIRV-Tools-shared SPIRV-Tools-reduce SPIRV-Tools-lint SPIRV-Tools-diff SPIRV-Tools-link
    PROPERTY EXCLUDE_FROM_ALL ON)

# Of SPIRV-Tools, which shaderc builds whole, only what shaderc links: a third of all its files less.
set(SKIP_SPIRV_TOOLS_INSTALL ON)
cmake_language(DEFER CALL set_property TARGET
    SPIRV-Tools-shared SPIRV-Tools-reduce SPIRV-Tools-lint SPIRV-Tools-diff SPIRV-Tools-link
    PROPERTY EXCLUDE_FROM_ALL ON)
# The headers that all of its files read, once for each library.
cmake_language(DEFER CALL target_precompile_headers SPIRV-Tools-opt PRIVATE
    ${CMAKE_CURRENT_SOURCE_DIR}/source/opt/pch_source_opt.h)
cmake_language(DEFER CALL target_precompile_headers SPIRV-Tools-static PRIVATE
    ${CMAKE_CURRENT_SOURCE_DIR}/source/val/validation_state.h)

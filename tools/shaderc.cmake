# For the suite's build of shaderc: a compiler that compiles each shader once gains nothing from having been
# optimised for minutes, nor from libraries that nobody links.
set(CMAKE_C_FLAGS_RELEASE "-O0 -DNDEBUG" CACHE STRING "" FORCE)
set(CMAKE_CXX_FLAGS_RELEASE "-O0 -DNDEBUG" CACHE STRING "" FORCE)
set(SHADERC_SKIP_EXAMPLES ON CACHE BOOL "" FORCE)
set(CMAKE_PROJECT_spirv-tools_INCLUDE ${CMAKE_CURRENT_LIST_DIR}/spirv-tools.cmake)

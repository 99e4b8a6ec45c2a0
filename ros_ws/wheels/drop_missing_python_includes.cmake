# The rosidl targets of the ROS 2 wheels name include folders of the interpreter that built the wheels
# (below /opt/python/), which exist on no other machine, and CMake refuses a target whose include folder is missing.
# Removes exactly those. scripts/build.sh has CMake include this file in every package (CMAKE_PROJECT_INCLUDE), so that the
# packages themselves are the same on any ROS 2.
function(_drop_missing_python_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders "${target}" INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT folders)
      continue()
    endif()
    set(kept "")
    foreach(folder IN LISTS folders)
      if(folder MATCHES "^/opt/python/" AND NOT EXISTS "${folder}")
        continue()
      endif()
      list(APPEND kept "${folder}")
    endforeach()
    if(NOT "${kept}" STREQUAL "${folders}")
      set_target_properties("${target}" PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
    endif()
  endforeach()
endfunction()

# Deferred to the end of the directory: ament_package() imports the last of the targets.
cmake_language(DEFER CALL _drop_missing_python_includes)

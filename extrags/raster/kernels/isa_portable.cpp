#define EXTRAGS_ISA portable
#define EXTRAGS_ISA_NAME "portable"
#include "kernels.inl"

#define EXTRAGS_ISA avx2
#define EXTRAGS_ISA_NAME "avx2"
#include "kernels.inl"

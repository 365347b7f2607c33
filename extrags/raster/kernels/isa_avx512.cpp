#define EXTRAGS_ISA avx512
#define EXTRAGS_ISA_NAME "avx512"
#include "kernels.inl"

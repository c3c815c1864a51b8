// Runs a fuzz target over files: the corpus in `make check`, one input to look at what it does.
#include <stdio.h>
#include <stdlib.h>

#include "tests/fuzz/fuzz.h"

#define LONGEST ((size_t)16 << 20)

int main(int argc, char **argv) {
    static uint8_t data[LONGEST];
    if (argc < 2) {
        fprintf(stderr, "usage: %s FILE ...\n", argv[0]);
        return 2;
    }
    for (int k = 1; k < argc; k++) {
        FILE *file = fopen(argv[k], "rb");
        if (file == NULL) {
            perror(argv[k]);
            return 1;
        }
        size_t n = fread(data, 1, sizeof data, file);
        fclose(file);
        fprintf(stderr, "%s\r", argv[k]); // the one to blame for a crash
        LLVMFuzzerTestOneInput(data, n);
    }
    printf("%s: %d inputs\n", argv[0], argc - 1);
    return 0;
}

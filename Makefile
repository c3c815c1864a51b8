# fbard: one non-recursive Makefile. `make help` lists the targets; `make V=1` shows the commands.
-include config.mk

# The one list of what a fresh Debian 12 machine lacks.
PACKAGES = build-essential pkg-config libmicrohttpd-dev libcjson-dev libzmq3-dev libhdf5-dev \
	libcurl4-gnutls-dev libxxhash-dev libcmocka-dev gnuplot-nox fonts-dejavu-core curl openssl \
	python3 python3-numpy python3-h5py python3-pytest python3-pytest-xdist python3-zmq python3-jsonschema \
	python3-hypothesis slowhttptest libjs-chart.js
# Needed by some targets only: the browser that tests the live page, and npm where there is no other one; clang
# builds and the fuzzers; `make check-long`.
PACKAGES_PAGE = chromium $(if $(shell command -v npm),,nodejs npm)
PACKAGES_CLANG = clang-14 libclang-rt-14-dev libomp-14-dev
PACKAGES_LONG = $(PACKAGES_CLANG) python3-paraview octave fonts-freefont-otf ghostscript prometheus zsh groff-base systemd iproute2 procps
# Pictures of the report; `make check` tests it, and so needs them too.
PACKAGES_REPORT = python3-matplotlib python3-pil

CC ?= gcc
ifeq ($(origin CC),default)
CC = gcc
endif
VARIANT ?= release
PREFIX ?= /usr/local
DESTDIR ?=
PYTHON ?= /usr/bin/python3
PKG_CONFIG ?= pkg-config
V ?= 0
Q = $(if $(filter 1,$(V)),,@)
say = $(if $(filter 1,$(V)),@:,@printf '  %-7s %s\n' $(1) $(2))

B = build/$(VARIANT)
VERSION = 0.1.0

WARN = -Wall -Wextra -Wpedantic -Wshadow -Wstrict-prototypes -Wmissing-prototypes -Wvla
CFLAGS.release = -O3 -g
CFLAGS.debug = -O0 -g3
CFLAGS.clang = -O2 -g
CFLAGS.asan = -O2 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer
CFLAGS.tsan = -O1 -g -fsanitize=thread
CFLAGS.tsanomp = $(CFLAGS.tsan)
CFLAGS.coverage = -O0 -g --coverage
CFLAGS.fuzz = -O1 -g -fsanitize=fuzzer-no-link,address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer
# One meaning of a*b + c for every compiler; no errno, no traps; never -ffast-math.
FLOAT = -ffp-contract=fast -fno-math-errno -fno-trapping-math
ALL_CFLAGS = -std=c17 -D_GNU_SOURCE -DFBARD_VERSION='"$(VERSION)"' -I. -MMD -MP $(WARN) $(FLOAT) $(CFLAGS.$(VARIANT)) $(CFLAGS)
OPENMP ?= -fopenmp
ifneq ($(filter tsan fuzz,$(VARIANT)),)
OPENMP =
endif
ALL_LDFLAGS = $(CFLAGS.$(VARIANT)) $(LDFLAGS)

pc_cflags = $(shell $(PKG_CONFIG) --cflags $(1))
pc_libs = $(shell $(PKG_CONFIG) --libs $(1))
HDF5_PC = $(shell $(PKG_CONFIG) --exists hdf5 && echo hdf5 || echo hdf5-serial)

# The kernels in lanes exist for instruction sets only, without a baseline.
LANES_SRC = server/mpm/transfer_2d.c server/mpm/transfer_3d.c
MPM_SRC = $(filter-out $(LANES_SRC),$(sort $(wildcard server/mpm/*.c server/mpm/material/*.c)))
PROTO_SRC = $(sort $(wildcard proto/*.c))
SERVER_SRC = $(sort $(wildcard server/*.c))
CLIENT_SRC = $(sort $(wildcard client/*.c))
SCENES = $(sort $(wildcard scenes/*.json scenes/hard/*.json))
TABLES = $(sort $(wildcard scenes/reference/*.csv))
# The live page, and the library that draws its curves.
CHARTJS ?= /usr/share/javascript/chart.js/chart.min.js
PAGE = $(sort $(wildcard server/page/*)) $(CHARTJS)

obj = $(patsubst %.c,$(B)/obj/%.o,$(1))

# What is compiled once more for each instruction set (server/mpm/simd.h): x.o, x.v3.o, x.v4.o of x.c.
# Not for the fuzzers, which are after readers: instrumented, kernels take clang many minutes. Nor where ThreadSanitizer
# is after the solver's threads: it sees no vectors of more than 16 bytes, and so none of what these kernels do to nodes.
ifneq ($(filter x86_64%,$(if $(filter fuzz tsanomp,$(VARIANT)),,$(shell $(CC) -dumpmachine))),)
LEVELS = v3 v4
endif
LANES.v3 = -march=x86-64-v3 -DMPM_LANES=4
LANES.v4 = -march=x86-64-v4 -mprefer-vector-width=512 -DMPM_LANES=8
levels = $(foreach level,$(LEVELS),$(patsubst %.c,$(B)/obj/%.$(level).o,$(1)))
lanes = $(call obj,$(1)) $(call levels,$(1))
$(B)/obj/server/mpm/kernels.o: ALL_CFLAGS += $(if $(LEVELS),-DMPM_HAS_LANES)
# Written in vectors: what the compiler would vectorise besides is scalar for a reason. Loops over components are to be
# unrolled, or these live in memory: GCC does so from -fpeel-loops on, clang always.
PEEL = $(if $(findstring clang,$(CC)),,-fpeel-loops)
LANES_FLAGS = $(if $(filter asan tsan tsanomp debug coverage,$(VARIANT)),-O1,-O2 $(PEEL)) -fno-tree-vectorize -fno-tree-slp-vectorize
$(call levels,$(LANES_SRC)): ALL_CFLAGS += $(LANES_FLAGS)

.PHONY: studies all programs deps deps-page deps-long deps-report libmpm demo report report-page report-docs check check-all check-layers check-unit \
	check-physics check-api check-page \
	check-cli check-loss check-hard check-shaken check-asan check-clang check-fuzz check-tsan check-tsan-solver unit-programs check-long bench bench-docs bench-solver bench-peer \
	bench-recording bench-page bench-status bench-threads bench-tutorial fuzz install uninstall format clean help
.DELETE_ON_ERROR:
.SECONDARY:

all: build/fbard build/fbar ## build everything

# build/fbard and build/fbar are the release programs; other variants stay in their own folder.
build/fbard: $(B)/fbard
	$(Q)cp $< $@.new && mv $@.new $@
build/fbar: $(B)/fbar
	$(Q)cp $< $@.new && mv $@.new $@

libmpm: $(B)/libmpm.a ## the solver library alone: needs a compiler and nothing else

$(B)/libmpm.a: $(call obj,$(MPM_SRC)) $(call levels,$(LANES_SRC))
	$(call say,AR,$@)
	$(Q)rm -f $@ && $(AR) rcs $@ $^

$(B)/obj/server/mpm/%.o: ALL_CFLAGS += $(OPENMP)
$(B)/obj/server/mpm/transfer.o: CFLAGS.fuzz = -O1 -g
SERVER_LIBS = libmicrohttpd libcjson libzmq libxxhash
CLIENT_LIBS = libcurl libcjson libzmq libxxhash $(HDF5_PC)
$(call obj,$(SERVER_SRC)): ALL_CFLAGS += $(call pc_cflags,$(SERVER_LIBS)) -pthread
$(call obj,$(CLIENT_SRC)): ALL_CFLAGS += $(call pc_cflags,$(CLIENT_LIBS)) -pthread
$(call obj,$(PROTO_SRC)): ALL_CFLAGS += $(call pc_cflags,libxxhash)

$(B)/obj/%.o: %.c Makefile
	$(call say,CC,$<)
	@mkdir -p $(@D)
	$(Q)$(CC) $(ALL_CFLAGS) -c $< -o $@

define lanes_rule
$(B)/obj/%.$(1).o: %.c Makefile
	$$(call say,CC,$$<:$(1))
	@mkdir -p $$(@D)
	$$(Q)$$(CC) $$(ALL_CFLAGS) $$(LANES.$(1)) -c $$< -o $$@
endef
$(foreach level,$(LEVELS),$(eval $(call lanes_rule,$(level))))

# The built-in scenes, the tables that they cite, the live page and the points of `fbar bench`, embedded as they are:
# $(1) files, $(2) name of the list, $(3) what a name leaves away of its path, $(4) and of its end. A scene in a folder
# within is called FOLDER-NAME.
embed = $(Q){ echo '\#include "proto/embedded.h"'; echo "extern const struct embedded $(2)[];"; i=0; \
	for f in $(1); do echo "static const char text_$$i[] = {"; i=$$((i + 1)); \
	od -An -v -tx1 $$f | sed "s/ \([0-9a-f][0-9a-f]\)/'\\\\x\1',/g"; echo "0};"; done; \
	echo "const struct embedded $(2)[] = {"; i=0; \
	for f in $(1); do n=$${f\#\#$(3)}; n=$$(echo $${n%$(4)} | tr / -); \
	echo "{\"$$n\", text_$$i, sizeof text_$$i - 1},"; i=$$((i + 1)); done; \
	echo "{0, 0, 0}};"; } > $@
$(B)/gen/scenes_data.c: $(SCENES) Makefile
	$(call say,EMBED,scenes)
	@mkdir -p $(@D)
	$(call embed,$(SCENES),scenes_data,scenes/,.json)
$(B)/gen/tables_data.c: $(TABLES) Makefile
	$(call say,EMBED,tables)
	@mkdir -p $(@D)
	$(call embed,$(TABLES),tables_data,*/,.csv)
$(B)/gen/page_data.c: $(PAGE) Makefile
	$(call say,EMBED,page)
	@mkdir -p $(@D)
	$(call embed,$(PAGE),page_data,*/,)
$(CHARTJS):
	@echo "$@ is missing: make deps installs it (Debian's libjs-chart.js), or set CHARTJS"; exit 1
$(B)/gen/bench_data.c: bench/accuracy.json Makefile
	$(call say,EMBED,$<)
	@mkdir -p $(@D)
	$(call embed,$<,bench_data,*/,.json)
GEN_OBJ = $(addprefix $(B)/obj/gen/,scenes_data.o tables_data.o page_data.o)
BENCH_POINTS = $(B)/obj/gen/bench_data.o
$(GEN_OBJ) $(BENCH_POINTS): $(B)/obj/gen/%.o: $(B)/gen/%.c
	@mkdir -p $(@D)
	$(Q)$(CC) $(ALL_CFLAGS) -c $< -o $@

SERVER_OBJ = $(filter-out %/main.o,$(call obj,$(SERVER_SRC))) $(GEN_OBJ)
$(B)/fbard: $(call obj,server/main.c) $(SERVER_OBJ) $(call obj,$(PROTO_SRC)) $(B)/libmpm.a
	$(call say,LD,$@)
	$(Q)$(CC) $(ALL_LDFLAGS) -pthread $(OPENMP) $^ $(call pc_libs,$(SERVER_LIBS)) -lm -o $@
$(B)/fbar: $(call obj,$(CLIENT_SRC)) $(call obj,$(PROTO_SRC)) $(BENCH_POINTS)
	$(call say,LD,$@)
	$(Q)$(CC) $(ALL_LDFLAGS) -pthread $^ $(call pc_libs,$(CLIENT_LIBS)) -lm -o $@

# Tests: tests/unit/test_*.c and tests/physics/test_*.c are cmocka programs, linked against everything.
UNIT = $(patsubst tests/%.c,$(B)/tests/%,$(sort $(wildcard tests/unit/test_*.c)))
PHYSICS = $(patsubst tests/%.c,$(B)/tests/%,$(sort $(wildcard tests/physics/test_*.c)))
$(B)/obj/tests/%.o: ALL_CFLAGS += $(call pc_cflags,$(SERVER_LIBS) cmocka) -Wno-missing-prototypes
$(B)/tests/unit/test_simd $(B)/tests/unit/test_laws: $(call lanes,tests/unit/lanes.c)
$(B)/tests/%: $(B)/obj/tests/%.o $(SERVER_OBJ) $(call obj,$(PROTO_SRC)) $(B)/libmpm.a
	$(call say,LD,$@)
	@mkdir -p $(@D)
	$(Q)$(CC) $(ALL_LDFLAGS) -pthread $(OPENMP) $^ $(call pc_libs,$(SERVER_LIBS) cmocka) -lm -o $@

BENCH_LANES = $(call levels,bench/stages_2d.c bench/stages_3d.c)
BENCH_OBJ = $(call obj,$(addprefix bench/,solver.c stages.c scenes.c)) $(BENCH_LANES)
$(B)/obj/bench/%.o: ALL_CFLAGS += $(call pc_cflags,$(SERVER_LIBS)) $(OPENMP) $(if $(LEVELS),-DMPM_HAS_LANES) -Wno-missing-prototypes
$(BENCH_LANES): ALL_CFLAGS += $(LANES_FLAGS)
$(B)/bench-solver: $(BENCH_OBJ) $(SERVER_OBJ) $(call obj,$(PROTO_SRC)) $(B)/libmpm.a
	$(call say,LD,$@)
	$(Q)$(CC) $(ALL_LDFLAGS) -pthread $(OPENMP) $^ $(call pc_libs,$(SERVER_LIBS)) -lm -o $@

$(B)/obj/bench/runner.o: ALL_CFLAGS += $(call pc_cflags,libcjson)
$(B)/runner: $(B)/obj/bench/runner.o $(SERVER_OBJ) $(call obj,$(PROTO_SRC)) $(B)/libmpm.a
	$(call say,LD,$@)
	$(Q)$(CC) $(ALL_LDFLAGS) -pthread $(OPENMP) $^ $(call pc_libs,$(SERVER_LIBS)) -lm -o $@

# Fuzz targets: tests/fuzz/fuzz_*.c, driven by libFuzzer in VARIANT=fuzz, else by replay.c.
FUZZ = $(patsubst tests/%.c,$(B)/tests/%,$(sort $(wildcard tests/fuzz/fuzz_*.c)))
FUZZ_DRIVER = $(if $(filter fuzz,$(VARIANT)),,$(B)/obj/tests/fuzz/replay.o)
$(B)/tests/fuzz/%: $(B)/obj/tests/fuzz/%.o $(B)/obj/tests/fuzz/replay.o $(SERVER_OBJ) $(call obj,client/frameinfo.c $(PROTO_SRC)) $(B)/libmpm.a
	$(call say,LD,$@)
	@mkdir -p $(@D)
	$(Q)$(CC) $(ALL_LDFLAGS) $(if $(FUZZ_DRIVER),,-fsanitize=fuzzer) -pthread $(OPENMP) \
	  $(filter-out $(if $(FUZZ_DRIVER),,%/replay.o),$^) $(call pc_libs,$(SERVER_LIBS)) -lm -o $@

## ---- Checks ----

deps: ## install what is missing (Debian packages; as root or with sudo)
	@missing=; for p in $(PACKAGES); do \
	  dpkg-query -W -f='$${Status}' $$p 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then \
	  echo "installing:$$missing"; as=; [ "$$(id -u)" = 0 ] || as=sudo; \
	  $$as apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $$as apt-get install -y -qq --no-install-recommends $$missing >/dev/null; fi

deps-long: deps
	@$(MAKE) --no-print-directory deps PACKAGES="$(PACKAGES_LONG)"

deps-page: deps-report
	@$(MAKE) --no-print-directory deps PACKAGES="$(PACKAGES_PAGE)"

deps-report: deps
	@$(MAKE) --no-print-directory deps PACKAGES="$(PACKAGES_REPORT)"

# Everything that a commit must pass. deps first, alone: what follows asks pkg-config.
check: deps-page ## build and run all tests (installs what is missing)
	@$(MAKE) --no-print-directory -j$$(nproc) all programs
	@$(MAKE) --no-print-directory check-all

# The test programs, built but not run: in parallel, where the tests themselves run one by one.
programs: $(UNIT) $(PHYSICS) $(FUZZ) $(B)/tests/failing.so $(B)/runner

check-all: all
	$(Q)$(MAKE) --no-print-directory check-layers check-unit check-physics check-hard check-api check-page check-cli check-loss
	$(Q)$(MAKE) --no-print-directory check-asan

check-layers: all
	$(Q)tests/layers.sh

SPIN = 2000 # as fbard has it: threads that outnumber the cores give way to each other
LEFT_OUT = # names of unit tests that are not run
UNIT_RUN = $(filter-out $(LEFT_OUT:%=$(B)/tests/unit/test_%),$(UNIT))
unit-programs: $(UNIT_RUN)
check-unit: $(UNIT_RUN) ## cmocka tests of every module
	$(Q)set -e; export GOMP_SPINCOUNT=$(SPIN); for t in $^; do echo "== $$t"; $$t; done

check-physics: $(PHYSICS) ## the solver against exact solutions and published values
	$(Q)set -e; export GOMP_SPINCOUNT=$(SPIN); for t in $^; do echo "== $$t"; $$t; done

PYTEST = $(PYTHON) -m pytest -q -p no:cacheprovider

check-api: all ## black-box tests of the daemon
	$(Q)FBARD=$(CURDIR)/$(B)/fbard FBAR=$(CURDIR)/$(B)/fbar $(PYTEST) tests/api

# Files of tests side by side: most of their time goes into starting programs and waiting for them.
check-cli: all ## black-box tests of the client
	$(Q)FBARD=$(CURDIR)/$(B)/fbard FBAR=$(CURDIR)/$(B)/fbar $(PYTEST) -n 2 --dist loadfile tests/cli

# The lock file's playwright-core drives Debian's chromium; it is installed into build/page, never into the tree.
PAGE_MODULES = build/page/node_modules
$(PAGE_MODULES)/.installed: tests/page/package.json tests/page/package-lock.json tests/page/.npmrc
	$(call say,NPM,$(@D))
	@mkdir -p build/page && cp $^ build/page
	$(Q)cd build/page && npm ci --ignore-scripts --silent --prefer-offline && touch node_modules/.installed
check-page: all $(PAGE_MODULES)/.installed ## the live page in a real browser
	$(Q)FBARD=$(CURDIR)/$(B)/fbard PAGE_MODULES=$(CURDIR)/build/page node --test --test-reporter=spec tests/page/page.test.mjs

# Preloaded by tests of check-loss: calls on the disk that fail.
$(B)/tests/failing.so: tests/loss/failing.c
	$(call say,LD,$@)
	@mkdir -p $(@D)
	$(Q)$(CC) -std=c17 -D_GNU_SOURCE $(WARN) -O1 -g -shared -fPIC -Wno-missing-prototypes $< -o $@ -ldl

check-loss: all $(B)/tests/failing.so ## kills, failing disks, recorders that stall: nothing is lost
	$(Q)FBARD=$(CURDIR)/$(B)/fbard FBAR=$(CURDIR)/$(B)/fbar FAILING=$(CURDIR)/$(B)/tests/failing.so $(PYTEST) -s tests/loss

# What a busy machine does to them, and more of it: none may fail, nor take anything for granted that is only likely.
SHAKEN = FBARD_LONG= FBARD=$(CURDIR)/$(B)/fbard FBAR=$(CURDIR)/$(B)/fbar FAILING=$(CURDIR)/$(B)/tests/failing.so PAGE_MODULES=$(CURDIR)/build/page tests/shake.py
check-shaken: all $(B)/tests/failing.so $(PAGE_MODULES)/.installed ## the tests while their processes are frozen and their threads starved (tests/shake.py)
	$(Q)set -e; for way in freeze starve; do echo "== $$way"; \
	  $(SHAKEN) $$way $(PYTEST) tests/api; $(SHAKEN) $$way $(PYTEST) -n 2 --dist loadfile tests/cli; $(SHAKEN) $$way $(PYTEST) tests/loss; \
	  $(SHAKEN) $$way node --test tests/page/page.test.mjs; done

# The same tests under AddressSanitizer and UBSan. `make check` leaves out what takes long there: the programs that
# step many variants through the same code, and the API but for requests that are wrong and the model; `make check-long` has it all.
ASAN_SLOW = $(if $(FBARD_LONG),,contact state boundary fbar)
ASAN_API = $(if $(FBARD_LONG),tests/api,$(wildcard tests/api/test_requests_*.py tests/api/test_runs_config.py) tests/api/test_model.py)
check-asan: ## unit and API tests with sanitizers
	$(Q)$(MAKE) --no-print-directory -j$$(nproc) VARIANT=asan LEFT_OUT="$(ASAN_SLOW)" \
	  build/asan/fbard build/asan/fbar unit-programs
	$(Q)$(MAKE) --no-print-directory VARIANT=asan LEFT_OUT="$(ASAN_SLOW)" check-unit check-fuzz
	$(Q)FBARD=$(CURDIR)/build/asan/fbard FBAR=$(CURDIR)/build/asan/fbar $(PYTEST) $(ASAN_API)

# One solver thread: GCC's OpenMP is not instrumented. tests/api/tsan.supp has the libraries that are not either.
check-tsan: ## many clients, subscribers and patches under ThreadSanitizer
	$(Q)$(MAKE) --no-print-directory -j$$(nproc) VARIANT=tsan build/tsan/fbard
	$(Q)FBARD=$(CURDIR)/build/tsan/fbard FBAR=$(CURDIR)/$(B)/fbar $(PYTEST) tests/api/test_threads.py tests/api/test_concurrency.py \
	  tests/api/test_watching.py tests/api/test_connections.py tests/api/test_model.py

# The solver's threads: LLVM's OpenMP tells ThreadSanitizer of its own waiting (archer), of which only its locks are seen.
TSAN_OMP = state boundary contact kernels
check-tsan-solver: ## the solver's threads under ThreadSanitizer, with clang 14
	$(Q)$(MAKE) --no-print-directory -j$$(nproc) CC=clang-14 VARIANT=tsanomp OPENMP=-fopenmp=libomp $(TSAN_OMP:%=build/tsanomp/tests/unit/test_%) build/tsanomp/tests/unit/test_team
	$(Q)set -e; export OMP_TOOL_LIBRARIES=/usr/lib/llvm-14/lib/libarcher.so TSAN_OPTIONS="ignore_noninstrumented_modules=1 suppressions=tests/unit/tsanomp.supp"; \
	  build/tsanomp/tests/unit/test_team test_race 2>&1 | grep -q "ThreadSanitizer: data race" || \
	    { echo "a race on purpose was not reported: none of the solver's would be"; exit 1; }; \
	  for t in $(TSAN_OMP); do echo "== $$t"; build/tsanomp/tests/unit/test_$$t '*thread*'; done; build/tsanomp/tests/unit/test_team

# The table of hard cases; `make check-long` has all of it and the ladder of time increments.
check-hard: $(B)/runner ## the hard cases: a verdict each (bench/hard.py), none worse than recorded
	$(Q)RUNNER=$(CURDIR)/$(B)/runner $(PYTHON) bench/hard.py $(if $(FBARD_LONG),,--quick) -o build/hard > build/hard.txt || { cat build/hard.txt; exit 1; }
	$(if $(FBARD_LONG),$(Q)RUNNER=$(CURDIR)/$(B)/runner $(PYTHON) bench/ladder.py -o build/hard)

check-fuzz: $(FUZZ) ## the fuzzers' corpus once more, without fuzzing
	$(Q)set -e; for t in $^; do $$t tests/fuzz/corpus/$${t##*fuzz_}/*; done

# New inputs go to build/fuzz/corpus; what crashes, hangs or leaks stays in build/fuzz as crash-*, to be added to
# tests/fuzz/corpus with the fix.
FUZZ_SECONDS ?= 600
fuzz: ## libFuzzer with clang 14, FUZZ_SECONDS (600) for each target
	$(Q)$(MAKE) --no-print-directory CC=clang-14 VARIANT=fuzz programs-fuzz
	$(Q)set -e; for t in $(notdir $(FUZZ)); do n=$${t#fuzz_}; mkdir -p build/fuzz/corpus/$$n; \
	  echo "== $$t"; build/fuzz/tests/fuzz/$$t -max_total_time=$(FUZZ_SECONDS) -timeout=20 -rss_limit_mb=4096 -max_len=20000 \
	  -print_final_stats=1 -artifact_prefix=build/fuzz/crash-$$n- build/fuzz/corpus/$$n tests/fuzz/corpus/$$n 2>build/fuzz/$$n.log || \
	  { tail -60 build/fuzz/$$n.log; exit 1; }; \
	  grep -E 'stat::(number_of_executed|new_units)|^Done' build/fuzz/$$n.log; done

.PHONY: programs-fuzz
programs-fuzz: $(FUZZ)

check-clang: ## warnings and unit tests with clang 14
	$(Q)$(MAKE) --no-print-directory CC=clang-14 VARIANT=clang OPENMP=-fopenmp=libomp CFLAGS=-Werror \
	  build/clang/fbard build/clang/fbar check-unit

check-long: deps-long deps-page ## the longer verification: minutes to hours
	@FBARD_LONG=1 $(MAKE) --no-print-directory check-all check-clang check-tsan check-tsan-solver check-shaken

bench: bench-solver bench-recording bench-status bench-threads ## speed: the kernels, what recording costs, how fast the daemon answers, when threads pay

# BENCH=GROUP: of one group only, e.g. kernels, or runout (a quarter of an hour, not in `make bench`); `make bench-docs` makes one table of what was measured.
bench-solver: $(B)/bench-solver ## kernels against the plain ones, ratios and growth; JSON in build/bench.json
	$(Q)GOMP_SPINCOUNT=$(SPIN) $< --json build/bench$(if $(BENCH),-$(BENCH)).json $(BENCH)

bench-docs: # docs/bench.md of what `make bench` or its groups left in build/
	$(Q)$(PYTHON) bench/docs.py build/bench*.json > docs/bench.md.new && mv docs/bench.md.new docs/bench.md

bench-peer: ## how to run the same block problem with another code
	@cat docs/peers.md

bench-recording: all ## what journal and recording cost a run, and how fast fbar records
	$(Q)FBARD=$(CURDIR)/$(B)/fbard FBAR=$(CURDIR)/$(B)/fbar $(PYTHON) bench/recording.py

bench-threads: all ## what a second thread is worth to runs of several sizes, on free and on busy cores
	$(Q)FBARD=$(CURDIR)/$(B)/fbard $(PYTHON) bench/threads.py

bench-page: all $(PAGE_MODULES)/.installed ## the live page with a million particles
	$(Q)FBARD=$(CURDIR)/$(B)/fbard PAGE_MODULES=$(CURDIR)/build/page node bench/page.mjs

bench-tutorial: ## the commands of docs/tutorial.md in a fresh clone: how long each takes
	$(Q)$(PYTHON) bench/tutorial.py

bench-status: all ## how fast the daemon answers while a run uses all cores, and what that costs the run
	$(Q)FBARD=$(CURDIR)/$(B)/fbard $(PYTHON) bench/status.py

## ---- Use ----

demo: deps ## the paper's dam break, F-bar on and off: pictures in build/demo (under 4 minutes)
	@$(MAKE) --no-print-directory all
	@scenes/demo.sh

# JOBS runs at a time. SIZE=small takes minutes, SIZE=paper hours; both go on where they were stopped or killed (bench/report/README.md).
SIZE ?= small
JOBS ?= $(shell nproc)
report: deps-report ## the paper's figures with our numbers: build/report/SIZE/report.html (SIZE=small, minutes; SIZE=paper, hours)
	@$(MAKE) --no-print-directory all $(B)/runner
	@$(MAKE) --no-print-directory studies
	@$(PYTHON) bench/report $(SIZE) --jobs $(JOBS) $(REPORT)

# Many small runs; what is done is kept in build/report/SIZE/points.jsonl, and they go on there.
STUDY = JOBS=$(JOBS) RUNNER=$(CURDIR)/$(B)/runner $(PYTHON)
studies: $(B)/runner
	@mkdir -p build/report/$(SIZE)
	@for study in "accuracy.py $(SIZE)" creep.py schemes.py tearing.py hard.py ladder.py; do echo "bench/$$study"; \
	  $(STUDY) bench/$$study -o build/report/$(SIZE) > build/report/$(SIZE)/study.txt || echo "bench/$$study: exit code $$?, see build/report/$(SIZE)/study.txt"; done

report-page: deps-report ## the same page of what was run so far; runs nothing
	@$(PYTHON) bench/report $(SIZE) --page

# Of the small size also the numbers that other docs have from it, which `make check` compares.
report-docs: deps-report ## docs/report-SIZE.md with its pictures and data, and numbers in docs, of what was run so far
	@$(PYTHON) bench/report $(SIZE) --page --docs
	@$(if $(filter small,$(SIZE)),$(PYTHON) bench/advice.py)

# What is generated for an installation: manual pages and completions from the tables of the programs, the solver's
# header as one file, and what names PREFIX.
I = $(B)/install
INSTALL ?= install
UNITDIR ?= $(PREFIX)/lib/systemd/system
BASHDIR ?= $(PREFIX)/share/bash-completion/completions
ZSHDIR ?= $(PREFIX)/share/zsh/site-functions
$(I)/fbar.1: $(B)/fbar
	@mkdir -p $(@D)
	$(Q)$< __manual > $@
$(I)/fbard.8: $(B)/fbard
	@mkdir -p $(@D)
	$(Q)$< --manual > $@
$(I)/fbar.bash $(I)/fbar.zsh: $(I)/fbar.%: $(B)/fbar
	@mkdir -p $(@D)
	$(Q)$< completion $* > $@
$(I)/mpm.h: server/mpm/mpm.h server/mpm/error.h server/mpm/fields.def
	@mkdir -p $(@D)
	$(Q)sed -e '/#include "server\/mpm\/error.h"/{r server/mpm/error.h' -e 'd}' \
	  -e '/#include "server\/mpm\/fields.def"/{r server/mpm/fields.def' -e 'd}' $< > $@
$(I)/libmpm.pc $(I)/fbard.service: $(I)/%: packaging/%.in FORCE
	@mkdir -p $(@D)
	$(Q)sed -e 's|@PREFIX@|$(PREFIX)|g' -e 's|@VERSION@|$(VERSION)|g' $< > $@
.PHONY: FORCE
INSTALLED = $(addprefix $(I)/,fbar.1 fbard.8 fbar.bash fbar.zsh mpm.h libmpm.pc fbard.service)

install: all $(INSTALLED) $(B)/libmpm.a ## into PREFIX (default /usr/local), under DESTDIR
	$(INSTALL) -d $(addprefix $(DESTDIR),$(PREFIX)/bin $(PREFIX)/include/libmpm $(PREFIX)/lib/pkgconfig $(UNITDIR) \
	  $(PREFIX)/share/fbard/scenes/reference $(PREFIX)/share/fbard/scenes/hard $(PREFIX)/share/man/man1 $(PREFIX)/share/man/man8 $(BASHDIR) $(ZSHDIR))
	$(INSTALL) $(B)/fbard $(B)/fbar $(DESTDIR)$(PREFIX)/bin
	$(INSTALL) -m 644 $(filter-out scenes/hard/%,$(SCENES)) scenes/README.md $(DESTDIR)$(PREFIX)/share/fbard/scenes
	$(INSTALL) -m 644 $(filter scenes/hard/%,$(SCENES)) $(DESTDIR)$(PREFIX)/share/fbard/scenes/hard
	$(INSTALL) -m 644 $(TABLES) $(DESTDIR)$(PREFIX)/share/fbard/scenes/reference
	$(INSTALL) -m 644 $(I)/fbar.1 $(DESTDIR)$(PREFIX)/share/man/man1
	$(INSTALL) -m 644 $(I)/fbard.8 $(DESTDIR)$(PREFIX)/share/man/man8
	$(INSTALL) -m 644 $(I)/fbar.bash $(DESTDIR)$(BASHDIR)/fbar
	$(INSTALL) -m 644 $(I)/fbar.zsh $(DESTDIR)$(ZSHDIR)/_fbar
	$(INSTALL) -m 644 $(I)/fbard.service $(DESTDIR)$(UNITDIR)
	$(INSTALL) -m 644 $(I)/mpm.h $(DESTDIR)$(PREFIX)/include/libmpm
	$(INSTALL) -m 644 $(B)/libmpm.a $(DESTDIR)$(PREFIX)/lib
	$(INSTALL) -m 644 $(I)/libmpm.pc $(DESTDIR)$(PREFIX)/lib/pkgconfig

uninstall: ## what install put there
	rm -f $(addprefix $(DESTDIR),$(addprefix $(PREFIX)/bin/,fbard fbar) $(PREFIX)/share/man/man1/fbar.1 \
	  $(PREFIX)/share/man/man8/fbard.8 $(BASHDIR)/fbar $(ZSHDIR)/_fbar $(UNITDIR)/fbard.service \
	  $(PREFIX)/lib/libmpm.a $(PREFIX)/lib/pkgconfig/libmpm.pc)
	rm -rf $(DESTDIR)$(PREFIX)/share/fbard $(DESTDIR)$(PREFIX)/include/libmpm

format: ## clang-format over all sources
	clang-format -i $(shell git ls-files '*.c' '*.h')

clean: ## remove build/
	rm -rf build

help: ## this list
	@sed -n 's/^\([a-z][a-z-]*\):.*## \(.*\)/  \1\t\2/p' Makefile | expand -t 18

-include $(shell find build -name '*.d' 2>/dev/null)

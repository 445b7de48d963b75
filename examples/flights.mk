# Align many flights on one machine: each folder below FLIGHTS that is not finished. A second call resumes. A flight that
# fails does not stop the others: make reports it, and returns exit code 2 at the end.
# Make splits names at spaces: the names of the folders must not contain any.
#
#     make -f examples/flights.mk FLIGHTS=season OUT=aligned
#
# On a Dask cluster: OPTIONS='--radiometry auto --qa --dask tcp://SCHEDULER:8786'.
FLIGHTS ?= flights
OUT ?= aligned
OPTIONS ?= --radiometry auto --qa

DONE := $(patsubst $(FLIGHTS)/%/,$(OUT)/%.done,$(sort $(wildcard $(FLIGHTS)/*/)))

MAKEFLAGS += --keep-going

all: $(DONE)

# Exit code 3 is a finished flight that must be checked: its name is kept, and make continues.
$(OUT)/%.done: $(FLIGHTS)/%/
	@mkdir -p $(OUT)
	agalign $< -o $(OUT)/$* $(OPTIONS); code=$$?; \
	case $$code in 0|3) agalign indices $(OUT)/$* --index ndvi --mask-qa || code=$$?;; esac; \
	if [ $$code -eq 3 ]; then echo $* >> $(OUT)/incomplete.txt; elif [ $$code -ne 0 ]; then exit $$code; fi
	@touch $@

.PHONY: all

# The commands a newcomer types. OMP_WAIT_POLICY=PASSIVE: on shared cores spinning threads made two threads twenty times slower than one.
export OMP_WAIT_POLICY = PASSIVE
PYTHON ?= python3
VENV ?= .venv
RUN = $(VENV)/bin

.PHONY: demo demo-quick test lint
.DEFAULT_GOAL := demo

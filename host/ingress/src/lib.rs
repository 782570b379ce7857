//! The ingress: receives every topic once, writes each sample once into sealed shared memory, and
//! shares it with all readers on this machine.

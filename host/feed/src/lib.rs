//! The reader's end of the ingress: attaches granted topics in shared memory, and waits for their
//! samples.

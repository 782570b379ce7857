//! Keeps hostile packets away from RustDDS, by a filter on its sockets.

use std::io;
use std::os::fd::OwnedFd;

use socket2::SockRef;
use tracing::warn;

use super::filter::{KNOWN, Prefix, program};
use super::sockets::Sockets;
use super::state::State;

/// Memory for options of a socket that is enough for a filter.
const OPTIONS: &str = "sysctl -w net.core.optmem_max=131072";

/// The filter of a participant's sockets.
pub(super) struct Guard {
    sockets: Vec<OwnedFd>,
    own: Prefix,
    /// What the filter lets pass.
    set: Option<(usize, Option<Vec<Prefix>>)>,
}

impl Guard {
    /// Attaches a filter that nothing passes which claims more than what discovery needs.
    pub(super) fn new(sockets: &Sockets, own: Prefix, state: &State) -> Self {
        let duplicates = sockets.duplicates().and_then(|duplicates| match duplicates.is_empty() {
            true => Err(io::Error::other("the participant's sockets were not found")),
            false => Ok(duplicates),
        });
        let sockets = duplicates.unwrap_or_else(|error| {
            tell(state, &error, "the kernel has to allow `pidfd_getfd`, as Linux 5.6 and newer do");
            Vec::new()
        });
        let mut guard = Self { sockets, own, set: None };
        guard.update(0, &[], state);
        guard
    }

    /// From now on, fragments of samples of up to `largest` bytes pass, of these participants and
    /// of our own.
    pub(super) fn update(&mut self, largest: usize, others: &[Prefix], state: &State) {
        if self.sockets.is_empty() {
            return;
        }
        // Whoever wants to be known announces itself. So if they are too many, nothing is lost by
        // knowing all.
        let known = (others.len() < KNOWN).then(|| [&[self.own], others].concat());
        let wanted = (largest, known);
        if self.set.as_ref() == Some(&wanted) {
            return;
        }
        let program = program(wanted.0, wanted.1.as_deref());
        for socket in &self.sockets {
            let socket = SockRef::from(socket);
            let attached = socket.attach_filter(&program).or_else(|_| {
                // The old one and the new one may be too much together. The first time there is no
                // old one.
                drop(socket.detach_filter());
                socket.attach_filter(&program)
            });
            if let Err(error) = attached {
                tell(state, &error, OPTIONS);
                self.sockets.clear();
                return;
            }
        }
        self.set = Some(wanted);
    }
}

fn tell(state: &State, error: &io::Error, help: &str) {
    warn!(%error, help, "no filter for hostile fragments: one packet may claim 4 GiB of memory");
    state.set_unfiltered(format!("no filter for hostile fragments: {error}"));
}

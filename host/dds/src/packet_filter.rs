//! Attaches a filter against hostile packets to the sockets of RustDDS.

use std::io;
use std::os::fd::OwnedFd;

use socket2::SockRef;
use tracing::warn;

use super::filter::{KNOWN, Prefix, program};
use super::sockets::Sockets;
use super::state::ParticipantState;

/// A limit of socket option memory that is enough for a filter.
const OPTIONS: &str = "sysctl -w net.core.optmem_max=131072";

pub(super) struct PacketFilter {
    sockets: Vec<OwnedFd>,
    own: Prefix,
    /// The current limits of the filter.
    set: Option<(usize, Option<Vec<Prefix>>)>,
}

impl PacketFilter {
    /// Attaches a filter that passes only what discovery needs.
    pub(super) fn new(sockets: &Sockets, own: Prefix, state: &ParticipantState) -> Self {
        let duplicates = sockets.duplicates().and_then(|duplicates| match duplicates.is_empty() {
            true => Err(io::Error::other("the participant's sockets were not found")),
            false => Ok(duplicates),
        });
        let sockets = duplicates.unwrap_or_else(|error| {
            report(
                state,
                &error,
                "the kernel has to allow `pidfd_getfd`, as Linux 5.6 and newer do",
            );
            Vec::new()
        });
        let mut filter = Self { sockets, own, set: None };
        filter.update(0, &[], state);
        filter
    }

    /// Lets fragments of samples of up to `largest` bytes pass, of these participants and of our
    /// own.
    pub(super) fn update(&mut self, largest: usize, others: &[Prefix], state: &ParticipantState) {
        if self.sockets.is_empty() {
            return;
        }
        // An attacker can announce itself anyway. So with too many participants, nothing is lost by
        // passing all.
        let known = (others.len() < KNOWN).then(|| [&[self.own], others].concat());
        let wanted = (largest, known);
        if self.set.as_ref() == Some(&wanted) {
            return;
        }
        let program = program(wanted.0, wanted.1.as_deref());
        for socket in &self.sockets {
            let socket = SockRef::from(socket);
            let attached = socket.attach_filter(&program).or_else(|_| {
                // The old and the new filter may exceed the limit together. The first time there is
                // no old one.
                drop(socket.detach_filter());
                socket.attach_filter(&program)
            });
            if let Err(error) = attached {
                report(state, &error, OPTIONS);
                self.sockets.clear();
                return;
            }
        }
        self.set = Some(wanted);
    }
}

fn report(state: &ParticipantState, error: &io::Error, help: &str) {
    warn!(%error, help, "cannot filter hostile fragments: one packet may claim 4 GiB of memory");
    state.set_unfiltered(format!("no filter for hostile fragments: {error}"));
}

//! Drops packets in the private network of the bench, by a rule of nftables.

use std::process::Command;

/// The table with the rule.
const TABLE: &str = "gleaner_bench";

/// Drops packets of UDP at random until it is dropped itself.
pub(super) struct PacketLoss {
    is_set: bool,
}

impl PacketLoss {
    /// Drops `permille` of 1,000 packets that arrive, of samples and of acknowledgements alike. For
    /// none, it has no rule.
    ///
    /// # Errors
    ///
    /// The reason why packets cannot be dropped.
    pub(super) fn of(permille: u32) -> Result<Self, String> {
        if permille > 0 {
            nft(&format!(
                "add table ip {TABLE}; add chain ip {TABLE} in {{ type filter hook input priority \
                 0; }}; add rule ip {TABLE} in meta l4proto udp numgen random mod 1000 < \
                 {permille} drop"
            ))?;
        }
        Ok(Self { is_set: permille > 0 })
    }
}

impl Drop for PacketLoss {
    fn drop(&mut self) {
        // The network ends with the bench.
        if self.is_set
            && let Err(why) = nft(&format!("delete table ip {TABLE}"))
        {
            eprintln!("packets are still dropped: {why}");
        }
    }
}

fn nft(rule: &str) -> Result<(), String> {
    let done = Command::new("nft").arg(rule).output();
    let done = done.map_err(|error| format!("`nft` cannot be started: {error}"))?;
    if done.status.success() {
        return Ok(());
    }
    Err(format!("`nft {rule}`: {}", String::from_utf8_lossy(&done.stderr).trim()))
}

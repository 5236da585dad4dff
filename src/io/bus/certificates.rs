//! Certificates of a network, and why an encrypted connection is refused.

use std::net::{Ipv6Addr, SocketAddr, TcpStream, ToSocketAddrs as _};
use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::QuicClientConfig;
use quinn::{ConnectionError, TransportErrorCode};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{AlertDescription, ClientConfig, RootCertStore};
use tokio::time::timeout;

use super::{BusError, TlsConfig};

/// Longest wait for the other end.
const WITHIN: Duration = Duration::from_secs(1);
/// The name of zenoh's protocol on an encrypted connection.
const PROTOCOL: &[u8] = b"zenoh";
/// The first of the error codes that are alerts of TLS.
const ALERTS: u64 = 0x100;

/// The content of the files.
pub(super) struct Certificates {
    roots: RootCertStore,
    own: Option<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>)>,
}

impl Certificates {
    pub(super) fn read(tls: &TlsConfig) -> Result<Self, BusError> {
        let TlsConfig { root_ca, certificate, key, client_certificates } = tls;
        let mut roots = RootCertStore::empty();
        if !root_ca.is_empty() {
            roots.add_parsable_certificates(chain("zenoh.tls.root_ca", root_ca)?);
        }
        let own = match (certificate.is_empty(), key.is_empty()) {
            (true, true) => None,
            (false, false) => {
                let chain = chain("zenoh.tls.certificate", certificate)?;
                let private = PrivateKeyDer::from_pem_file(key);
                Some((chain, private.map_err(|error| unreadable("zenoh.tls.key", key, &error))?))
            }
            (is_missing, _) => {
                let key = if is_missing { "zenoh.tls.certificate" } else { "zenoh.tls.key" };
                let reason = "certificate and key are given together".into();
                return Err(BusError::Setting { key, value: "\"\"".into(), reason });
            }
        };
        // As zenoh does.
        let is_sent = *client_certificates && !root_ca.is_empty();
        Ok(Self { roots, own: own.filter(|_| is_sent) })
    }

    fn client(&self) -> Result<quinn::ClientConfig, rustls::Error> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider);
        let builder = builder.with_protocol_versions(&[&rustls::version::TLS13])?;
        let builder = builder.with_root_certificates(self.roots.clone());
        let mut config = match &self.own {
            Some((chain, key)) => builder.with_client_auth_cert(chain.clone(), key.clone_key())?,
            None => builder.with_no_client_auth(),
        };
        config.alpn_protocols = vec![PROTOCOL.into()];
        let config = QuicClientConfig::try_from(config)
            .map_err(|error| rustls::Error::General(error.to_string()))?;
        Ok(quinn::ClientConfig::new(Arc::new(config)))
    }
}

/// Why an address refuses a connection, if something listens there. It is found by a connection of our own: zenoh only
/// says that it cannot connect.
pub(super) fn refusal(endpoint: &str, certificates: Option<&Certificates>) -> Option<String> {
    let (protocol, address) = endpoint.split(['?', '#']).next()?.split_once('/')?;
    let mut addresses = match address.to_socket_addrs() {
        Ok(addresses) => addresses,
        Err(error) => return Some(error.to_string()),
    };
    if protocol == "tcp" {
        let listens = addresses.any(|at| TcpStream::connect_timeout(&at, WITHIN).is_ok());
        let what = "a program is there, but it hangs, has another version, or is no node";
        return listens.then(|| what.into());
    }
    let (host, _) = address.rsplit_once(':')?;
    let config = match certificates?.client() {
        Ok(config) => config,
        Err(error) => return Some(format!("[bus.zenoh.tls]: {error}")),
    };
    // zenoh tries no other one either.
    let first = addresses.next()?;
    // The caller may be in a runtime of its own.
    let find = || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().ok()?;
        runtime.block_on(greet(&config, first, host))
    };
    std::thread::scope(|scope| scope.spawn(find).join()).unwrap_or_default()
}

/// Connects; returns why it failed, or why the other end has closed the connection afterwards.
async fn greet(config: &quinn::ClientConfig, at: SocketAddr, host: &str) -> Option<String> {
    let from: SocketAddr = match at {
        SocketAddr::V4(_) => ([0; 4], 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let endpoint = quinn::Endpoint::client(from).ok()?;
    let connecting = match endpoint.connect_with(config.clone(), at, host) {
        Ok(connecting) => connecting,
        Err(error) => return Some(format!("{error}; write the name of the host")),
    };
    let error = match timeout(WITHIN, connecting).await {
        // It judges our certificate after that.
        Ok(Ok(connection)) => timeout(WITHIN, connection.closed()).await.ok(),
        Ok(Err(error)) => Some(error),
        Err(_) => None,
    };
    // zenoh waits for the end of each connection before it accepts the next one.
    endpoint.close(0_u32.into(), &[]);
    let _ = timeout(WITHIN, endpoint.wait_idle()).await;
    meaning(&error?, host)
}

fn chain(key: &'static str, file: &str) -> Result<Vec<CertificateDer<'static>>, BusError> {
    let all = CertificateDer::pem_file_iter(file).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match all {
        Ok(all) if all.is_empty() => Err(unreadable(key, file, &"no certificate is in the file")),
        all => all.map_err(|error| unreadable(key, file, &error)),
    }
}

fn unreadable(key: &'static str, file: &str, why: &dyn std::fmt::Display) -> BusError {
    BusError::Setting { key, value: format!("{file:?}"), reason: why.to_string() }
}

/// What is to be mended, of an error while connecting to a host.
fn meaning(error: &ConnectionError, host: &str) -> Option<String> {
    use AlertDescription::{
        BadCertificate, CertificateExpired, CertificateRequired, DecryptError, UnknownCA,
    };
    let alert = |code: TransportErrorCode| {
        let alert = u64::from(code).checked_sub(ALERTS).and_then(|code| u8::try_from(code).ok());
        alert.map(AlertDescription::from)
    };
    match error {
        ConnectionError::TransportError(ours) => Some(match alert(ours.code) {
            // Two authorities may have one name.
            Some(UnknownCA | DecryptError) => {
                "its certificate is not signed by the authority in [bus.zenoh.tls] root_ca".into()
            }
            Some(BadCertificate) => format!(
                "its certificate does not hold for the name {host}: connect by a name in the \
                 certificate, or make a new one"
            ),
            Some(CertificateExpired) => "its certificate has expired, or a clock is wrong".into(),
            _ => ours.to_string(),
        }),
        ConnectionError::ConnectionClosed(theirs) => match alert(theirs.error_code)? {
            CertificateRequired => {
                Some("it wants a certificate: set [bus.zenoh.tls] certificate and key".into())
            }
            UnknownCA | BadCertificate | DecryptError => Some(
                "it does not accept [bus.zenoh.tls] certificate: another authority signed it"
                    .into(),
            ),
            CertificateExpired => {
                Some("[bus.zenoh.tls] certificate has expired, or a clock is wrong".into())
            }
            _ => Some(theirs.to_string()),
        },
        _ => None,
    }
}
